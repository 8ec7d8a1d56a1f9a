"""Virtual L2: the other end of the wire, with world, motion, the clock's real defect and faults."""
