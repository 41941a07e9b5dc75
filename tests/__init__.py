import os

# Before numpy is loaded. Tests run side by side, and small matrices on threads take several times the work: they wait
# for each other by running idle.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests start some fifty processes of the service and of workers. Without bytecode each compiles the same modules again:
# two seconds of a core a process.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
