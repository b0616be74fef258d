"""Trains whereabot's mask and joint networks on recordings and exports them for the engine."""

import ctypes
import os
import sys

__version__ = "0.1.0"

# On a CPU that other work shares, threads that spin at each barrier wait for those that are not scheduled: sleep instead.
# Must be set before PyTorch loads.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if sys.platform == "linux":
    # glibc returns each large tensor's memory to the kernel and takes it back page by page, a third of a training step
    # on a CPU: keep it (M_MMAP_MAX, M_TRIM_THRESHOLD, M_TOP_PAD).
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        pass
    else:
        for option, value in ((-4, 0), (-1, 2**31 - 1), (-2, 2**28)):
            mallopt(option, value)
