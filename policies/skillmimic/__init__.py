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
plan           what the arms do before any network: a clip's targets, corrections and linear feedback
optimise       finds the corrections, by CMA-ES
starts         where a skill starts: posture, place and flight of the ball
sight          the ball as a tracker sees it
train          the training run: sim2real train g1-ball
ablation       the paper's Table 1: every reward at equal samples
mixture        the paper's Table 3: each skill alone, and all in one policy
release        from a checkpoint to a policy file
through_bytes  the same judges in the deployed loop
card           all of it as a report; with tables, curves and film
"""
