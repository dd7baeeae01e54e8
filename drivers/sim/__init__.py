"""The simulated twin: the same bytes as a real robot's wires, with motors and a body behind them.

    world.py        everything below, moved on by one clock (lockstep)
    plant.py        the body, in MuJoCo; gantry.py: the crane it hangs from; truth.py: what only a simulation knows
    motor.py        emulated motors: what all protocols share; damiao.py, robstride.py, ...: one protocol each
    wire.py         CAN buses: frame times, arbitration, queues; faults.py: what can go wrong on them
    imu.py          HiPNUC packets on a serial line
    serve.py        a World in real time behind unix sockets; socket_wire.py: the hosts' ends of these

What each part does not model is in its docstring. What none does: electromagnetic interference other than by injected
faults, supply voltage and brown-outs, heat between motors, flexible links and backlash, wear.
"""
