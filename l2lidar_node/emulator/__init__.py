"""Virtual L2: the other end of the wire, with a world, a motion, a clock with the real defect, and faults."""
