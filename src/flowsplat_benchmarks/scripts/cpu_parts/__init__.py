"""The parts of the CPU benchmark, one module a subject; ``cpu.py`` beside this folder is the command."""
