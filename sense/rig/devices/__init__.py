"""What all devices of a rig share: their protocols, how they are found, serial ports, child processes."""
