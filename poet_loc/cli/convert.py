"""poet-loc convert FORMAT: each format is a module of convert_commands."""

COMMANDS = {
    "bop": "BOP scenes become one log each, with ground truth and the map derived from it",
    "checkpoint": "an official PoET checkpoint becomes a safetensors file, safely",
    "classes": "class and symmetry files of YCB-V or LM-O",
    "poet": "PoET's results.json becomes the object poses of a log, with the stamps that it lacks",
    "tum": "a camera trajectory becomes the camera poses of a log",
}
