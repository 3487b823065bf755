"""The networks of a calibration while they are trained: the masked one in torch, and the published one."""
