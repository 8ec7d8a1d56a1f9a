"""Demo of the whole chain without hardware: a virtual L2, the driver, and an observer."""
