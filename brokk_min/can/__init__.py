"""The CAN bus: CANopen frames, safety gate, operator input, simulated machine, drive log."""
