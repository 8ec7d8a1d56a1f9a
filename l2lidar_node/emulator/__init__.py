"""Virtual L2, the other end of the wire: a world, a motion, the real clock defect, faults."""
