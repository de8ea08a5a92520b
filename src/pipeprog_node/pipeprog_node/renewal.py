# SPDX-License-Identifier: Apache-2.0
"""The service `~/renew` of a node: between two surveys it is destroyed and made anew in the same process.

Whatever the node had of the last survey goes with it, so that nothing of it has to be named to be forgotten.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from pipeprog_camera.errors import InputError
from pipeprog_msgs.srv import Renew

MakeNode = Callable[..., Node]


class RenewableNode:
    """Keeps a node in an executor and makes it anew when it is asked to.

    The service belongs to a node of its own, hidden and without parameters, which stays.
    """

    def __init__(self, make: MakeNode, executor: Executor, renewed: Collection[str]) -> None:
        """`renewed`: names of the fields of Renew that are parameters of the node; none: it is never made anew.

        For that, `make` gets a list of parameters that go before those of the command line and of files.
        """
        self._make, self._executor, self._renewed = make, executor, renewed
        self._node = make()
        executor.add_node(self._node)
        self._asked: tuple[Renew.Request, Future] | None = None
        self._keeper = self._made_keeper() if renewed else None

    def renew_if_asked(self) -> None:
        """Makes the node anew if a request is pending; to be called between two callbacks."""
        if self._asked is None:
            return
        (request, done), self._asked = self._asked, None
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        problem = ""
        try:
            self._node = self._make(self._parameters(request))
        except InputError as error:
            problem = str(error)
            self._node = self._make(self._parameters(Renew.Request(idle=True)))
        self._executor.add_node(self._node)
        gc.collect()  # the old one holds itself in circles, and 10 MB of images; Python looks for them by counts alone
        done.set_result(problem)

    def destroy(self) -> None:
        """Destroys the node and its keeper."""
        self._node.destroy_node()
        if self._keeper is not None:
            self._keeper.destroy_node()

    def _made_keeper(self) -> Node:
        keeper = Node(
            f"_{self._node.get_name()}_renewal",
            namespace=self._node.get_namespace(),
            use_global_arguments=False,  # a name given for the process is that of the node
            start_parameter_services=False,
            enable_rosout=False,
        )
        name = f"{self._node.get_fully_qualified_name()}/renew"
        keeper.create_service(Renew, name, self._on_request, callback_group=ReentrantCallbackGroup())
        self._executor.add_node(keeper)
        return keeper

    async def _on_request(self, request: Renew.Request, response: Renew.Response) -> Renew.Response:
        if self._asked is not None:
            response.message = "another request is pending: wait for its answer"
            return response
        done = Future()
        self._asked = request, done
        response.message = await done
        response.success = not response.message
        return response

    def _parameters(self, request: Renew.Request) -> list[Parameter]:
        """What a request sets; a text that is empty leaves what is configured."""
        given = {name: getattr(request, name) for name in self._renewed}
        return [Parameter(name, value=value) for name, value in given.items() if value != ""]
