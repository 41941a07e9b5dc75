import os

# Before numpy is loaded. Tests run side by side, and small matrices on threads take several times the work: they wait
# for each other by running idle.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
