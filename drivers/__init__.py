"""The hardware layer: motor buses, wires, codecs, IMUs, and their simulated twins. Imports nothing of ours from above."""
