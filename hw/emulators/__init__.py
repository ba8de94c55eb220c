"""The far end of the wires: a UR controller and a HEX-70 DAQ, in a process of their own."""
