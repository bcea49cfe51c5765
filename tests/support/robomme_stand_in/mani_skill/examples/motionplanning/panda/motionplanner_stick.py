"""The stick's planner: on the package index it hands its base an argument too many."""

from mani_skill import KIND


class BaseMotionPlanningSolver:
    def __init__(self, env, vis=True, print_env_info=True, joint_vel_limits=0.9):
        self.settings = (env, vis, print_env_info, joint_vel_limits)


class PandaStickMotionPlanningSolver(BaseMotionPlanningSolver):
    def __init__(
        self,
        env,
        vis=True,
        visualize_target_grasp_pose=True,
        print_env_info=True,
        joint_vel_limits=0.9,
    ):
        if KIND == "fork":
            super().__init__(env, vis, print_env_info, joint_vel_limits)
        else:
            super().__init__(
                env, vis, visualize_target_grasp_pose, print_env_info, joint_vel_limits
            )
