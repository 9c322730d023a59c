"""Studies of the robot's pushes of table 1: causes of the prediction error, and predicted distributions."""
