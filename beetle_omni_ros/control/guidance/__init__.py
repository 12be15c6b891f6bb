"""What may stand around a controller: pose targets, moved so that the robot gets there."""
