"""The ball of training is the ball of every simulated world: drivers/sim/ball.py."""

from drivers.sim.ball import CONTACTS as CONTACTS
from drivers.sim.ball import FRICTION as FRICTION
from drivers.sim.ball import MASS as MASS
from drivers.sim.ball import NAME as NAME
from drivers.sim.ball import RADIUS as RADIUS
from drivers.sim.ball import RESTITUTION as RESTITUTION
from drivers.sim.ball import Contact as Contact
from drivers.sim.ball import ball as ball
from drivers.sim.ball import contact as contact
