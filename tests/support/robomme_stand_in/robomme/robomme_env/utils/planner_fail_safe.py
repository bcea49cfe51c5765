"""RoboMME's motion planner without its plans: it reaches two of the three containers."""


class ScrewPlanFailure(RuntimeError):
    pass


class FailAwarePandaArmMotionPlanningSolver:
    def __init__(self, env, base_pose, **settings):
        assert base_pose is env.unwrapped.agent.robot.pose
        self.env = env

    def move_to_pose_with_screw(self, target):
        raise ScrewPlanFailure(f"no straight way to {target.number}")

    def move_to_pose_with_RRTStar(self, target):
        if target.number == 2:
            return -1
        self.env.step([target.number] * 7 + [1])
        return None
