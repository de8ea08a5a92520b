# SPDX-License-Identifier: Apache-2.0
"""The door of a node: each message is checked and converted before anything of the node sees it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import for_terminal

Message = TypeVar("Message")
Value = TypeVar("Value")


class InvalidMessageError(InputError):
    """A message that cannot be used; `kind` is the short name under which it is counted."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class Intake:
    """Subscriptions of a node whose messages are converted first; what cannot be is dropped, counted and said once.

    What the network lost on the way is counted as well, where the middleware notices it: best-effort data on Wi-Fi.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._rejected: Counter[tuple[str, str]] = Counter()
        self._lost: Counter[str] = Counter()

    def subscribe(
        self,
        message_type: type[Message],
        topic: str,
        convert: Callable[[Message], Value],
        use: Callable[[Value], None],
        profile: QoSProfile,
        overriding: QoSOverridingOptions | None = None,
        dropped: Callable[[Message], None] | None = None,
    ) -> Subscription:
        """Subscribes; `use` gets what `convert` makes of each message for which it raises no InputError.

        `dropped` gets the others, for nodes in which something waits for them.
        """

        def receive(message: Message) -> None:
            try:
                value = convert(message)
            except InputError as error:
                self.reject(topic, error)
                if dropped is not None:
                    dropped(message)
                return
            use(value)

        def lose(lost: QoSMessageLostInfo) -> None:
            self._lost[topic] += lost.total_count_change

        return self._node.create_subscription(
            message_type,
            topic,
            receive,
            profile,
            event_callbacks=SubscriptionEventCallbacks(message_lost=lose),
            qos_overriding_options=overriding,
        )

    def reject(self, source: str, error: InputError) -> None:
        """Counts what was dropped from a topic or service, and says the first of each kind in words."""
        kind = error.kind if isinstance(error, InvalidMessageError) else "invalid"
        self._rejected[source, kind] += 1
        if self._rejected[source, kind] == 1:
            self._node.get_logger().error(
                f"dropped a message on {self._node.resolve_topic_name(source)}: {for_terminal(str(error))}; "
                "more of this kind are counted in /diagnostics"
            )

    @property
    def rejected(self) -> int:
        """Messages dropped so far."""
        return self._rejected.total()

    @property
    def lost(self) -> int:
        """Messages so far that the network lost on the way."""
        return self._lost.total()

    def health(self) -> dict[str, Any]:
        """Numbers of dropped messages by topic and kind, and of lost ones by topic, for the diagnostics."""
        dropped = {f"dropped on {source}: {kind}": count for (source, kind), count in sorted(self._rejected.items())}
        return {**dropped, **{f"lost on the way to {topic}": count for topic, count in sorted(self._lost.items())}}
