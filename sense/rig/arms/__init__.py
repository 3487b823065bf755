"""Arms that press: drivers of a UR5 and of a 3D printer."""
