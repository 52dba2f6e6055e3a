"""Many units and drives: logs as columns, the daemon's own kernels over them on a cluster, and statistics over units."""
