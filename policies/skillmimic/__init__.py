"""SkillMimic (Wang et al., 2024) for a robot: ball skills learned from retargeted clips, observed with a robot's own senses.

config         everything to tune, one dataclass; the tasks
world          robot and ball in MuJoCo, with palms that do not bounce
clips          the clips as one table of reference instants, and what standing and holding ask of the motors
rewards        equations 2 to 7 and 14 to 17, and how variants combine them
terminations   when an episode has failed
randomisation  what differs between robots, balls and trackers
observations   what the actor sees
graph          the policy: signals in, joint targets out; what is exported
env            all of it together, many robots at once; what the critic sees
amp            the discriminator of the AMP variant
evaluate       the paper's measures
stance         clips for robots whose legs a base policy moves
train          the training run: sim2real train g1-ball
release        from a checkpoint to a policy file
"""
