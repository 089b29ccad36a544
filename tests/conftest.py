"""One BLAS thread, as in every process of a run: sums in one order, so that equal inputs give equal bits."""

import threadpoolctl

threadpoolctl.threadpool_limits(1)
