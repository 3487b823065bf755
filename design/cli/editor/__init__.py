"""Drawing fibres by hand, in a browser of this machine."""
