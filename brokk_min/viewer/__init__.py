"""To see the machine and to drive it: pictures, a window to play in, films of runs."""
