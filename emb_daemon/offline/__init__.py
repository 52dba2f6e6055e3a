"""The offline toolbox: logs read once, the estimator run over them, fits through it, and scores against references."""

from emb_daemon.offline.log import Log, corner_index, load_log, log_of
from emb_daemon.offline.run import estimate

__all__ = ["Log", "corner_index", "estimate", "load_log", "log_of"]
