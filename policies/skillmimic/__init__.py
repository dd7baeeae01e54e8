"""SkillMimic (Wang et al., 2024) for a robot: ball skills learned from retargeted clips, observed with a robot's own senses.

config        everything to tune, one dataclass; the skills and which clips show them
world         robot and ball in MuJoCo, with palms that do not bounce
clips         the clips as one table of reference frames
rewards       equations 2 to 7 and 14 to 17, and how variants combine them
terminations  when an episode has failed
senses        what differs between robots, balls and trackers, and what is measured of them
observations  what the actor sees, and what only the critic sees
graph         the policy: signals in, joint targets out; what is exported
env           all of it together, many robots at once
amp           the discriminator of the AMP variant
train         the training run
"""
