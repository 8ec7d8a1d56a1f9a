"""Managed node (https://design.ros2.org/articles/node_lifecycle.html).

A manager, or ``ros2 lifecycle``, configures, activates, deactivates and cleans it up. With
``autostart``, the default, it becomes active by itself, like a plain node.
"""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Generator
from typing import Any, Final

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import (
    LifecycleNode,
    LifecyclePublisher,
    LifecycleState,
    TransitionCallbackReturn as Return,
)

from l2lidar_node.ros.program import StartError
from l2lidar_node.settings import SettingError

_DESTROYING: Final = frozenset(  # the services that set_up created
    (
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_INACTIVE_SHUTDOWN,
        Transition.TRANSITION_ACTIVE_SHUTDOWN,
    )
)


class NextTurn:
    """Awaitable that yields to the executor once."""

    def __await__(self) -> Generator[None, None, None]:
        """Yield to the executor."""
        yield


class ManagedNode(LifecycleNode):
    """Base class of the nodes; a subclass implements each transition.

    Whatever ROS entities :meth:`set_up` and :meth:`begin` create are destroyed by the transition
    that undoes them; a subclass only gives up what else it holds.

    Parameters
    ----------
    name : str
    """

    def __init__(self, name: str) -> None:
        self._answering = 0  # calls of services that are waiting for something
        self._is_destroyed = False
        super().__init__(name)
        self._problem: Exception | None = None  # what start() has to raise
        self._before_set_up: set[Any] = set()
        self._before_begin: set[Any] = set()
        # rclpy's own answer raises where a transition is impossible now, which ends the program.
        self._answer_change_state = self._service_change_state.callback
        self._service_change_state.callback = self._change_state

    # ---- for subclasses

    def set_up(self) -> None:
        """Configure: open publishers, sockets, files.

        Raises
        ------
        SettingError, StartError
        """

    def begin(self) -> None:
        """Activate: take input, publish.

        Raises
        ------
        SettingError, StartError
        """

    def pause(self) -> None:
        """Deactivate: take no more input."""

    def tear_down(self) -> None:
        """Clean up: give up all that :meth:`set_up` opened, even if it got half way only."""

    def shared_entities(self) -> list[Any]:
        """Return entities that others use as well and that no transition may destroy."""
        return []

    async def allows(self, transition: int) -> bool:
        """Return whether a requested transition may take place.

        Parameters
        ----------
        transition : int
            Of ``lifecycle_msgs/Transition``; it is possible in the node's state.
        """
        del transition
        return True

    def create_service(self, kind: Any, name: str, callback: Any, **options: Any) -> Any:
        """Create a service whose callback may be a coroutine.

        An answer of a service that is destroyed meanwhile would end the program, so transitions
        that destroy services wait for it.
        """
        is_coroutine = inspect.iscoroutinefunction(callback)
        return super().create_service(
            kind, name, self._counted(callback) if is_coroutine else callback, **options
        )

    def _counted(self, callback: Any) -> Any:
        async def answer(request: Any, response: Any) -> Any:
            self._answering += 1
            try:
                return await callback(request, response)
            finally:
                self._answering -= 1

        return answer

    # ---- state

    @property
    def is_active(self) -> bool:
        """Whether the node is at work."""
        return bool(self._current_state[0] == State.PRIMARY_STATE_ACTIVE)

    @property
    def is_configured(self) -> bool:
        """Whether the node is active or could be at once."""
        configured = (State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE)
        return self._current_state[0] in configured

    @property
    def state_label(self) -> str:
        """Name of the state: unconfigured, inactive, active, finalized, or on the way to one."""
        return self._current_state[1]

    @property
    def _current_state(self) -> tuple[int, str]:
        if self._is_destroyed:
            return State.PRIMARY_STATE_FINALIZED, "finalized"
        number, label = self._state_machine.current_state
        return int(number), str(label)

    def start(self, autostart: bool) -> None:
        """Configure and activate the node if it is to start by itself; the end of a constructor.

        Raises
        ------
        Exception
            Whatever kept it from that.
        """
        if not autostart:
            self.get_logger().info("waiting to be configured (autostart is false)")
            return
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not Return.SUCCESS:
                problem, self._problem = self._problem, None
                assert problem is not None
                raise problem

    def destroy_node(self) -> None:
        """Give everything up, then destroy the node."""
        if self._is_destroyed:
            return
        if self.is_configured:
            self.tear_down()
        self._is_destroyed = True
        super().destroy_node()
        # rclpy forgets this, and what it holds keeps the node in the graph. To ask it afterwards
        # would crash.
        self._state_machine.destroy_when_not_in_use()

    # ---- transitions, as rclpy calls them

    def on_configure(self, state: LifecycleState) -> Return:
        """Run :meth:`set_up`; undo it if it fails."""
        del state
        self._before_set_up = self._entities()
        if self._succeeds(self.set_up):
            return Return.SUCCESS
        self._succeeds(self.tear_down, keeps_problem=True)
        self._destroy_since(self._before_set_up)
        return Return.FAILURE

    def on_activate(self, state: LifecycleState) -> Return:
        """Let the publishers publish and run :meth:`begin`."""
        self._before_begin = self._entities()
        super().on_activate(state)
        if self._succeeds(self.begin):
            return Return.SUCCESS
        super().on_deactivate(state)
        self._destroy_since(self._before_begin)
        return Return.FAILURE

    def on_deactivate(self, state: LifecycleState) -> Return:
        """Run :meth:`pause` and silence the publishers."""
        self._succeeds(self.pause)
        self._destroy_since(self._before_begin)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> Return:
        """Run :meth:`tear_down`."""
        del state
        self._succeeds(self.tear_down)
        self._destroy_since(self._before_set_up)
        return Return.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> Return:
        """Release what the node holds in its present state."""
        if state.state_id == State.PRIMARY_STATE_ACTIVE:
            self._succeeds(self.pause)
        if state.state_id != State.PRIMARY_STATE_UNCONFIGURED:
            self.on_cleanup(state)
        return Return.SUCCESS

    def _succeeds(self, step: Callable[[], None], keeps_problem: bool = False) -> bool:
        try:
            step()
        except Exception as error:
            # What is in the log is not kept: its frames hold whatever the step had opened.
            if not self._log(error) and not keeps_problem:
                self._problem = error
            return False
        return True

    def _log(self, error: Exception) -> bool:
        """Name an error in the log; return False where the program ends with it anyway."""
        if self.executor is None or not self.context.ok():
            return False
        is_foreseen = isinstance(error, SettingError | StartError)
        self.get_logger().error(str(error) if is_foreseen else traceback.format_exc())
        return True

    async def _change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        asked = request.transition
        response.success = False
        possible = {
            label: number for number, label, *_ in self._state_machine.available_transitions
        }
        # The label counts where there are both, as for rclpy.
        transition = possible.get(asked.label, 0) if asked.label else int(asked.id)
        if transition in possible.values() and not await self.allows(transition):
            return response
        while self._answering and transition in _DESTROYING:
            await NextTurn()
        try:
            return self._answer_change_state(request, response)  # rclpy has no types
        except RCLError as error:
            what = f"transition '{asked.label or asked.id}' in state '{self.state_label}'"
            self.get_logger().warning(f"{what} refused: {str(error).partition(', at ')[0]}")
            return response

    # ---- entities

    def _entities(self) -> set[Any]:
        """Return all entities of the node."""
        lists = (self.publishers, self.subscriptions, self.clients, self.services, self.timers)
        return {entity for some in (*lists, self.guards) for entity in some}

    def _destroy_since(self, before: set[Any]) -> None:
        """Destroy the entities that are not in ``before``."""
        kept = before | set(self.shared_entities())
        for publisher in [found for found in self.publishers if found not in kept]:
            if isinstance(publisher, LifecyclePublisher):
                self.destroy_lifecycle_publisher(publisher)
            else:
                self.destroy_publisher(publisher)
        for found, destroy in (
            (self.subscriptions, self.destroy_subscription),
            (self.clients, self.destroy_client),
            (self.services, self.destroy_service),
            (self.timers, self.destroy_timer),
            (self.guards, self.destroy_guard_condition),
        ):
            for entity in [some for some in found if some not in kept]:
                if getattr(entity, "topic_name", "") != "/clock":  # use_sim_time is set live
                    destroy(entity)
        # rclpy's group keeps a reference to every entity that there ever was.
        known = self.default_callback_group.entities
        known.difference_update([found for found in known if found() is None])
