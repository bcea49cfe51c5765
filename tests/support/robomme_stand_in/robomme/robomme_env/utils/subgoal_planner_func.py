"""RoboMME's solvers without their geometry."""


def solve_pickup_bin(env, planner, obj=None):
    planner.move_to_pose_with_screw(obj)
    env.picked = obj
    for _ in range(2):
        env.step([obj.number] * 7 + [-1])
