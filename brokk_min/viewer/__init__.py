"""To see the machine and to drive it: drawings, window, play, replay, tracing."""
