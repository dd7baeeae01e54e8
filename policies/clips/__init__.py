"""From motion capture to a robot's reference motions.

skeleton, ballplay   the recordings of BallPlay-M, and the body they were made with
format               a clip: our own file, of a human or of a robot
kinematics, flight, contact, check     what a clip says, and whether it is physics
resample, mirror     another rate, another side
robot, targets, retarget               the same skill on a robot
feasibility          what remains wrong, in numbers
library              which clips there are; ``robot_clips("g1", "pickup")`` for training
draw, commands       pictures, and what ``sim2real clips`` does
"""
