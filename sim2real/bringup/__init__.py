"""From a bag of motors to a robot that may be armed: looking at the machine, at the buses, and at the motors on them."""
