import os
import sys

# Before numpy is loaded. Tests run side by side, and small matrices on threads take several times the work: they wait
# for each other by running idle.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests start some fifty processes of the service and of workers. Without bytecode each compiles the same modules again:
# two seconds of a core a process.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# The same for this process: pytest rewrites the assertions of all test files, twelve seconds of a core for each worker
# of xdist, and keeps them as bytecode.
sys.dont_write_bytecode = False

# The C library gives the memory of a large array back to the system at once, and the next array is filled with zeros
# again by the system: a tenth of the time of these tests. The processes that are started from here keep it.
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(4 * 2**30))
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(4 * 2**30))
