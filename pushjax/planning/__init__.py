"""Plans of pushes and grasps that reach a goal, also where friction is not known."""
