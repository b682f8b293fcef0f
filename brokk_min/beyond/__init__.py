"""Our improvements on the paper, one file each; no file of the method imports them."""
