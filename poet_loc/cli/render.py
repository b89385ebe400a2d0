"""poet-loc render KIND: each kind of rendered data is a module of render_commands."""

COMMANDS = {
    "images": "random images of the household world as a BOP data set, for training",
    "videos": "hand-held videos of the household world as log folders, with IMU and ground truth",
}
