"""Our improvements on the paper: one file each, which plugs into the method and can be deleted."""
