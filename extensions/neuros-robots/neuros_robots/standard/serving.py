"""A MuJoCo node serves the standard: others look at its world, change it, pause it and step it.

A step of the standard is one timestep of the model, whoever makes it: the simulator's own thread,
or a hook of the project, which waits in its ``step_...`` while the simulation is paused.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from neuros.errors import NodeError
from neuros.time import to_stamp
from neuros_robots.standard.foreign import interfaces, snake

if TYPE_CHECKING:
    from neuros.simulators.mujoco import MuJoCo

_JOIN_S = 2.0
_WORLD = ("", "world")
_BOTH = ("SIMULATION_STATE_GETTING", "SIMULATION_STATE_SETTING", "SIMULATION_STATE_PAUSE")
_STEPS = ("STEP_SIMULATION_SINGLE", "STEP_SIMULATION_MULTIPLE", "STEP_SIMULATION_ACTION")
_ENTITIES = ("ENTITY_STATE_GETTING", "ENTITY_STATE_SETTING", "ENTITY_INFO_GETTING")
_RESET = ("SIMULATION_RESET", "SIMULATION_RESET_TIME", "SIMULATION_RESET_STATE")


def serve(node: Any, sim: MuJoCo, prefix: str = "") -> None:
    """Serve ``simulation_interfaces`` for a simulator, in the ROS domain of the run.

    Args:
        node: the ``node`` of the hook.
        sim: its simulator.
        prefix: before the names of the services: ``robot`` for ``/robot/step_simulation``.

    Raises:
        NodeError: in virtual time, which knows no requests from outside; or if there is no message
            package of the standard.
    """
    if node.virtual_time is not None:
        raise NodeError("in virtual time, nobody outside can step a simulator: leave out serve()")
    server = _Server(node, sim, prefix)
    sim.share()
    node.on_close(server.close)


class _Refused(Exception):
    """A request that is answered with the name of a result, and a text."""

    def __init__(self, result: str, text: str) -> None:
        self.result = result
        super().__init__(text)


class _Server:
    """The services, on a ROS node and in threads of their own: a hook may wait meanwhile."""

    def __init__(self, node: Any, sim: MuJoCo, prefix: str) -> None:
        from rclpy.action import ActionServer
        from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
        from rclpy.context import Context
        from rclpy.executors import MultiThreadedExecutor
        from rclpy.node import Node as RosNode

        self._node, self._sim, self._types = node, sim, interfaces()
        self._is_over = self._is_stopped = False
        self._steps = threading.Lock()
        project_node = node.get_ros_node()
        self._context = Context()
        self._context.init(domain_id=project_node.context.get_domain_id())
        self._ros = RosNode(
            f"{node.name}_simulation",
            context=self._context,
            namespace=project_node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
        )
        # What takes long leaves a thread for the others.
        long = MutuallyExclusiveCallbackGroup()
        before = f"{prefix.strip('/')}/" if prefix.strip("/") else ""
        for kind, answer in (
            ("GetSimulatorFeatures", self._get_features),
            ("GetSimulationState", self._get_state),
            ("SetSimulationState", self._set_state),
            ("StepSimulation", self._step),
            ("ResetSimulation", self._reset),
            ("GetEntities", self._get_entities),
            ("GetEntityState", self._get_entity_state),
            ("GetEntitiesStates", self._get_entities_states),
            ("SetEntityState", self._set_entity_state),
            ("GetEntityInfo", self._get_entity_info),
        ):
            self._ros.create_service(
                getattr(self._types.srv, kind),
                before + snake(kind),
                self._answering(answer),
                callback_group=long if kind == "StepSimulation" else None,
            )
        self._action = ActionServer(
            self._ros,
            self._types.action.SimulateSteps,
            f"{before}simulate_steps",
            self._simulate_steps,
            callback_group=long,
        )
        self._executor = MultiThreadedExecutor(2, context=self._context)
        self._executor.add_node(self._ros)
        self._thread = threading.Thread(
            target=self._executor.spin, name=f"{node.name}: services", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the services; a step that has not ended is answered as failed."""
        self._is_over = True
        self._executor.shutdown(_JOIN_S)
        self._thread.join(_JOIN_S)
        self._action.destroy()
        self._ros.destroy_node()
        self._context.try_shutdown()

    def _answering(self, answer: Callable[[Any, Any], object]) -> Callable[[Any, Any], Any]:
        """A callback whose response says whether the request was carried out, or why not."""

        def callback(request: Any, response: Any) -> Any:
            self._say(response, answer, request)
            return response

        return callback

    def _say(self, response: Any, answer: Callable[[Any, Any], object], request: Any) -> None:
        code, text = "RESULT_OK", ""
        try:
            answer(request, response)
        except _Refused as refusal:
            code, text = refusal.result, str(refusal)
        except Exception as error:  # whoever asks learns it; the run goes on
            code, text = "RESULT_OPERATION_FAILED", f"{type(error).__name__}: {error}"
        if hasattr(response, "result"):
            kind = self._types.msg.Result
            owner = kind if hasattr(kind, code) else type(response)
            response.result = kind(result=getattr(owner, code), error_message=text)

    # ---- simulation -------------------------------------------------------------------------

    @property
    def _resets(self) -> bool:
        """A hook that steps it may be in the middle of its steps, with packets on their way."""
        return self._sim.is_running

    def _get_features(self, request: Any, response: Any) -> None:
        kind = self._types.msg.SimulatorFeatures
        names = (*_BOTH, *_STEPS, *_ENTITIES, *(_RESET if self._resets else ()))
        response.features.features = [getattr(kind, name) for name in names]
        response.features.custom_info = "MuJoCo, in a node of NeuROS"

    def _get_state(self, request: Any, response: Any) -> None:
        kind = self._types.msg.SimulationState
        state = kind.STATE_PLAYING
        if self._sim.is_paused or self._node.is_paused:
            state = kind.STATE_STOPPED if self._is_stopped else kind.STATE_PAUSED
        response.state.state = state

    def _set_state(self, request: Any, response: Any) -> None:
        kind, wanted = self._types.msg.SimulationState, request.state.state
        self._get_state(None, response_of_now := self._types.srv.GetSimulationState.Response())
        if wanted not in (kind.STATE_PLAYING, kind.STATE_PAUSED, kind.STATE_STOPPED):
            text = "end the run of the project in the place of the simulator"
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        self._refuse_in_pause_of_run()
        if response_of_now.state.state == wanted:
            raise _Refused("ALREADY_IN_TARGET_STATE", "")
        if wanted == kind.STATE_PLAYING:
            self._is_stopped = False
            self._sim.resume()
            return
        self._sim.pause()
        self._is_stopped = wanted == kind.STATE_STOPPED
        if self._is_stopped:
            self._reset_now()

    def _step(self, request: Any, response: Any) -> None:
        missing = self._make(request.steps)
        if missing:
            text = f"{missing} of {request.steps} steps were not made: the simulation was resumed"
            text = "the run has ended" if self._is_ended else text
            raise _Refused("RESULT_OPERATION_FAILED", text)

    def _simulate_steps(self, goal: Any) -> Any:
        kind = self._types.action.SimulateSteps
        result, feedback = kind.Result(), kind.Feedback()

        def steps(request: Any, _: Any) -> None:
            for done in range(1, request.steps + 1):
                self._step(self._types.srv.StepSimulation.Request(steps=1), None)
                feedback.completed_steps = done
                feedback.remaining_steps = request.steps - done
                goal.publish_feedback(feedback)

        self._say(result, steps, goal.request)
        is_done = result.result.result == self._types.msg.Result.RESULT_OK
        goal.succeed() if is_done else goal.abort()
        return result

    def _make(self, count: int) -> int:
        """Have whatever steps the simulator make steps; returns how many are missing."""
        self._refuse_in_pause_of_run()
        if not self._sim.is_paused:
            text = "the simulation is not paused: set STATE_PAUSED first"
            raise _Refused("RESULT_OPERATION_FAILED", text)
        self._is_stopped = False
        with self._steps:
            return self._sim.step_paused(count, lambda: self._is_ended or self._node.is_paused)

    @property
    def _is_ended(self) -> bool:
        return self._is_over or self._node.is_ending

    def _refuse_in_pause_of_run(self) -> None:
        if self._node.is_paused:
            text = "the run of the project is paused, by its dashboard or session: resume that"
            raise _Refused("RESULT_INCORRECT_STATE", text)

    def _reset(self, request: Any, response: Any) -> None:
        kind = type(request)
        if request.scope not in (
            kind.SCOPE_DEFAULT,
            kind.SCOPE_ALL,
            kind.SCOPE_TIME | kind.SCOPE_STATE,
        ):
            text = "time and state are reset together, and spawned entities stay"
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        self._reset_now()

    def _reset_now(self) -> None:
        if not self._resets:
            text = (
                "a hook of the project steps this simulator, in lockstep with other nodes: reset"
                " the project, in a session"
            )
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        self._sim.reset()

    # ---- entities ---------------------------------------------------------------------------

    def _entities(self) -> list[str]:
        """The bodies that stand in the world, with all that hangs on them."""
        model = self._sim.model
        bodies = (model.body(number) for number in range(1, model.nbody))
        return [body.name for body in bodies if body.name and body.parentid[0] == 0]

    def _chosen(self, filters: Any) -> Iterable[str]:
        if filters.categories or filters.tags.tags or filters.bounds.type:
            text = "entities are chosen by 'filter', a regular expression for their names"
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        try:
            wanted = re.compile(filters.filter)
        except re.error as error:
            raise _Refused("RESULT_OPERATION_FAILED", f"filter: {error}") from error
        return [name for name in self._entities() if wanted.search(name)]

    def _body(self, name: str) -> int:
        import mujoco

        number = int(mujoco.mj_name2id(self._sim.model, mujoco.mjtObj.mjOBJ_BODY, name))
        if number < 1:
            known = ", ".join(self._entities()) or "none"
            raise _Refused("RESULT_NOT_FOUND", f"there is no body '{name}' (entities: {known})")
        return number

    def _state_of(self, name: str) -> Any:
        import mujoco
        import numpy as np

        from neuros.simulators.mujoco.world import forward

        model, data, number = self._sim.model, self._sim.data, self._body(name)
        forward(model, data)  # after a step, MuJoCo's positions of bodies are one step old
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, number, velocity, 0)
        state = self._types.msg.EntityState()
        state.header.frame_id = "world"
        state.header.stamp = to_stamp(self._sim.sim_time)
        _put(state.pose.position, "xyz", data.xpos[number])
        _put(state.pose.orientation, "wxyz", data.xquat[number])
        _put(state.twist.angular, "xyz", velocity[:3])
        _put(state.twist.linear, "xyz", velocity[3:])
        return state

    def _get_entities(self, request: Any, response: Any) -> None:
        with self._sim.paused():
            response.entities = self._chosen(request.filters)

    def _get_entity_state(self, request: Any, response: Any) -> None:
        with self._sim.paused():
            response.state = self._state_of(request.entity)

    def _get_entities_states(self, request: Any, response: Any) -> None:
        with self._sim.paused():
            names = list(self._chosen(request.filters))
            response.states = [self._state_of(name) for name in names]
            response.entities = names

    def _get_entity_info(self, request: Any, response: Any) -> None:
        with self._sim.paused():
            model, number = self._sim.model, self._body(request.entity)
            root = model.body_rootid[number]
            joints = [
                j for j in range(model.njnt) if model.body_rootid[model.jnt_bodyid[j]] == root
            ]
            is_driven = any(int(model.actuator_trnid[a][0]) in joints for a in range(model.nu))
        kind = self._types.msg.EntityCategory
        moving = kind.CATEGORY_ROBOT if is_driven else kind.CATEGORY_DYNAMIC_OBJECT
        response.info.category.category = moving if joints else kind.CATEGORY_STATIC_OBJECT

    def _set_entity_state(self, request: Any, response: Any) -> None:
        sets_pose = getattr(request, "set_pose", True)  # before 2.1, everything is set
        sets_twist = getattr(request, "set_twist", True)
        state, is_newer = request.state, hasattr(request, "set_acceleration")
        if is_newer and request.set_acceleration:
            text = "MuJoCo computes accelerations; none can be set"
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        if state.header.frame_id not in _WORLD:
            text = f"the state is in the frame '{state.header.frame_id}': give it in the world's"
            raise _Refused("RESULT_FEATURE_UNSUPPORTED", text)
        quaternion = _get(state.pose.orientation, "wxyz")
        length = sum(each * each for each in quaternion) ** 0.5
        numbers = [*quaternion, *_get(state.pose.position, "xyz")]
        if sets_pose and not (abs(length - 1) < 1e-3 and all(abs(n) < 1e9 for n in numbers)):
            raise _Refused("INVALID_POSE", f"the pose has numbers that it cannot have: {numbers}")
        twist = [*_get(state.twist.linear, "xyz"), *_get(state.twist.angular, "xyz")]
        if sets_twist and not all(abs(n) < 1e9 for n in twist):
            text = f"the twist has numbers that it cannot have: {twist}"
            raise _Refused("RESULT_OPERATION_FAILED", text)
        with self._sim.paused():
            self._put_state(self._body(request.entity), state, sets_pose, sets_twist)

    def _put_state(self, number: int, state: Any, sets_pose: bool, sets_twist: bool) -> None:
        import mujoco
        import numpy as np

        model, data = self._sim.model, self._sim.data
        joint = int(model.body_jntadr[number])
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            text = f"body '{model.body(number).name}' has no free joint: its state cannot be set"
            raise _Refused("RESULT_OPERATION_FAILED", text)
        position, velocity = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        if sets_pose:
            data.qpos[position : position + 3] = _get(state.pose.position, "xyz")
            data.qpos[position + 3 : position + 7] = _get(state.pose.orientation, "wxyz")
        if sets_twist:
            # MuJoCo has the angular velocity of a free joint in the frame of the body.
            turned, inverse = np.zeros(3), np.zeros(4)
            mujoco.mju_negQuat(inverse, data.qpos[position + 3 : position + 7])
            mujoco.mju_rotVecQuat(turned, np.array(_get(state.twist.angular, "xyz")), inverse)
            data.qvel[velocity : velocity + 3] = _get(state.twist.linear, "xyz")
            data.qvel[velocity + 3 : velocity + 6] = turned


def _put(message: Any, fields: str, values: Any) -> None:
    for field, value in zip(fields, values, strict=True):
        setattr(message, field, float(value))


def _get(message: Any, fields: str) -> list[float]:
    return [getattr(message, field) for field in fields]
