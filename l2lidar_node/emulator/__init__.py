"""Virtual L2: the other end of the wire, with world, motion, the real clock's defect and faults."""
