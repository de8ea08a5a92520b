# SPDX-License-Identifier: Apache-2.0
"""The managed node `survey`: one action that films, lets the graph finish, and writes the results folder."""

from __future__ import annotations

import gc
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from pipeprog_bringup.survey.alignment_result import is_aligned
from pipeprog_bringup.survey.conducted_survey import ConductedSurvey
from pipeprog_bringup.survey.goal import check_goal, read_reference, read_site
from pipeprog_bringup.survey.missing_input import missing_input, missing_odometry
from pipeprog_bringup.survey.progress import site_progress
from pipeprog_bringup.survey.robot_input import RobotInput
from pipeprog_bringup.survey.survey_journal import unfinished
from pipeprog_bringup.survey.survey_output import SurveyOutput
from pipeprog_bringup.survey.takeover import SIGN_PERIOD, Takeover
from pipeprog_bringup.survey.waiting_client import Client
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import for_terminal
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import SiteProgress
from pipeprog_node import messages, qos
from pipeprog_node.main import run
from pipeprog_node.parameters import declare_fixed

TICK = 0.1  # s between two looks at what a survey waits for
RESULT_TIMEOUT = 6 * 3600  # s that a result is kept for: a robot asks for it when it is home
USABLE = {Survey.Result.NONE, Survey.Result.NOT_ALIGNED, Survey.Result.NO_SPACE}  # codes of surveys with pipes


class SurveyNode(LifecycleNode):
    """Conducts one survey after another; nothing of one is kept for the next."""

    def __init__(self) -> None:
        super().__init__("survey")
        self._boq = declare_fixed(self, "boq", "", "file of the bill of quantities, where a goal names none")
        self._board = declare_fixed(self, "board", "", "file of the boards, where a goal names none")
        self._results = Path(declare_fixed(self, "results", "surveys", "folder that each survey gets a folder in"))
        self._record = declare_fixed(self, "record", False, "keep the images of each survey as recording.mcap")
        self._cameras = declare_fixed(self, "cameras", "", "of a rig, as of frames: whose images are kept").split()
        self._running: Client | None = None
        self._survey: ConductedSurvey | None = None
        self._left = unfinished(self._results)
        self._takeover = Takeover(self._results, self.get_fully_qualified_name())
        self._is_active = self._end_asked = False
        self._waiting: list[Future] = []
        group = ReentrantCallbackGroup()  # while a survey waits, the other callbacks must run
        self._action = ActionServer(
            self,
            Survey,
            "survey",
            self._execute,
            callback_group=group,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            result_timeout=RESULT_TIMEOUT,
        )
        self._progress = self.create_publisher(SiteProgress, "progress", qos.latched())
        self._end = self.create_service(Trigger, "~/end", self._on_end, callback_group=group)
        self._pause = self.create_service(SetBool, "~/pause", self._on_pause, callback_group=group)
        # Steady time: a paused recording stops ROS time.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(TICK, self._wake, callback_group=group, clock=steady)
        self._taking_up = self.create_timer(TICK, self._take_up, callback_group=group, clock=steady)
        self._sign = self.create_timer(SIGN_PERIOD, self._show_life, callback_group=group, clock=steady)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Reads the files that the parameters name, so that a mistake is known before the robot walks."""
        try:
            if self._boq:
                read_site(self._boq, self._board)
        except InputError as error:
            self.get_logger().error(for_terminal(str(error)))
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Goals are accepted; a survey whose node was killed a moment ago goes on."""
        self._is_active = True
        self._show_life()
        left, self._left = self._left, None
        if left is not None and self._running is None:
            request = deserialize_message(left.goal, Survey.Goal)
            self._running = Client(request.survey_id, None)  # a goal of this name that comes now is of its client
            self.executor.create_task(self._run, self._running, request, left.folder)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """No goal is accepted any more; the survey that is filmed goes on to its result."""
        self._end_activity()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Refused while a survey goes on to its result: a manager waits for seconds, a survey may take minutes."""
        if self._running is not None:
            self.get_logger().error(
                f"cleanup refused: the survey {self._running.name} is not over: wait for its result, or cancel it"
            )
            return TransitionCallbackReturn.FAILURE
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As `on_deactivate`: a shutdown cannot be refused, and the process goes on until it gets a signal."""
        self._end_activity()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """An exception in a transition leads to the state unconfigured, from which the node can be configured again."""
        self._end_activity()
        self.get_logger().error(f"a transition from the state {state.label} has failed: configure the node again")
        return super().on_error(state)

    def _end_activity(self) -> None:
        self._is_active = False
        self._takeover.end()
        self._end_asked = True

    def _take_up(self) -> None:
        """Becomes active where the process before was, when it was killed, and its survey goes on."""
        self._taking_up.cancel()
        if self._left is not None:
            self.get_logger().warning(f"the survey {self._left.folder.parent.name} goes on")
        if self._left is not None or self._takeover.was_active:
            self.trigger_configure()
            self.trigger_activate()

    def _show_life(self) -> None:
        if self._is_active:
            self._takeover.sign()

    def destroy_node(self) -> None:
        """Ends the node as its user wishes: the next one is not active by itself."""
        self._takeover.end()
        # Both are the node's own and rclpy leaves them: it would be in the graph for as long as Python keeps them.
        self._action.destroy()
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def _on_goal(self, request: Survey.Goal) -> GoalResponse:
        is_free = self._running is None or self._running.is_of(request)
        return GoalResponse.ACCEPT if self._is_active and is_free else GoalResponse.REJECT

    def _on_end(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._running is not None
        response.message = "filming ends" if response.success else "no survey is running"
        self._end_asked = response.success
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        problem = self._survey.pause(request.data) if self._survey is not None else "no survey is running"
        response.success = not problem
        response.message = problem or ("the survey is paused" if request.data else "the survey goes on")
        return response

    async def _execute(self, handle: ServerGoalHandle) -> Survey.Result:
        request: Survey.Goal = handle.request
        client = self._running
        if client is None:
            result = self._takeover.answer_to(request) or await self._run(Client("", handle), request)
        elif client.is_of(request):
            client.handle = handle
            result = await client.result
        else:  # two goals came before one was executed
            handle.abort()
            return Survey.Result(error_code=Survey.Result.GOAL_REJECTED, error_msg="another survey is running")
        if handle.is_cancel_requested:
            handle.canceled()
        elif result.pipes.map_revision and result.error_code in USABLE:
            handle.succeed()
        else:
            handle.abort()
        return result

    async def _run(self, client: Client, request: Survey.Goal, left: Path | None = None) -> Survey.Result:
        """The result of a survey from its beginning, or from where a process that was killed has `left` it."""
        self._running, self._end_asked = client, not self._is_active  # it may have been deactivated meanwhile
        started = time.monotonic()
        try:
            result = await self._conducted(client, request, left)
        except Exception as error:  # a fault of this program: its client hears of it, and the next survey can begin
            result = self._of_fault(error)
        finally:
            self._running = None
        gc.collect()  # its node and messages hold each other in circles, which Python looks for by counts of objects
        result.total_elapsed_time = messages.duration_msg(time.monotonic() - started)
        if result.error_msg:
            self.get_logger().error(for_terminal(result.error_msg))
        client.result.set_result(result)
        return result

    async def _conducted(self, client: Client, request: Survey.Goal, left: Path | None) -> Survey.Result:
        try:
            site = read_site(request.boq or self._boq, request.board or self._board)
            limit = messages.seconds(request.time_limit)
            goal = check_goal(request.survey_id, site, limit, self.get_clock().now().nanoseconds)
            if request.reference:
                goal = replace(goal, reference=read_reference(request.reference, self._results))
            client.name = request.survey_id = goal.name
            output = SurveyOutput(self._results, goal, self._record, left)
            journal = output.journal_of(serialize_message(request))
        except InputError as error:
            return Survey.Result(error_code=Survey.Result.BAD_INPUT, error_msg=str(error))
        # A node of this survey alone: with it goes all that was subscribed.
        listener = Node("survey_listener", namespace=self.get_namespace(), use_global_arguments=False)
        self.executor.add_node(listener)
        robot = RobotInput(self, output, self._cameras) if self._record else None
        try:
            self._survey = ConductedSurvey(
                listener,
                client,
                goal,
                output,
                journal,
                self._tick,
                is_end_asked=lambda: self._end_asked,
                lack=lambda: missing_input(self, self._cameras),
                lack_of_odometry=lambda: missing_odometry(self),
                keep=self._takeover.keep,
            )
            result = await self._survey.run()
        except Exception as error:  # what was filmed is kept, and the name is free for a later process
            result = self._of_fault(error)
            result.folder = output.rescue()
        finally:
            self._survey = None
            journal.close()
            if robot is not None:
                robot.close()
            self.executor.remove_node(listener)
            listener.destroy_node()
        if goal.reference is not None and is_aligned(result):
            folders = goal.reference.path.parent, Path(result.folder)
            self.executor.create_task(self._publish_progress, *folders, result.pipes.header)
        return result

    def _of_fault(self, error: Exception) -> Survey.Result:
        """The result of a survey that a fault of this program ends, while it is handled."""
        self.get_logger().error(traceback.format_exc())
        text = f"a fault of pipeprog has ended the survey: {type(error).__name__}: {error}"
        return Survey.Result(error_code=Survey.Result.UNKNOWN, error_msg=text)

    async def _publish_progress(self, earlier: Path, later: Path, header: Header) -> None:
        """Tells what has changed since the reference: it takes seconds, for which no result waits."""
        with ThreadPoolExecutor(1) as pool:
            told = pool.submit(site_progress, earlier, later, header)
            while not told.done():
                await self._tick()
        try:
            self._progress.publish(told.result())
        except InputError as error:
            self.get_logger().warning(f"no progress since {earlier.name}: {for_terminal(str(error))}")

    async def _tick(self) -> None:
        future = Future()
        self._waiting.append(future)
        await future

    def _wake(self) -> None:
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            future.set_result(None)


def main() -> None:
    """Entry point of survey_node."""
    run(SurveyNode)


if __name__ == "__main__":
    main()
