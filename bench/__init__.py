"""The benchmark: tasks, the runner, records and reports."""

import os

# Threads of OpenMP that wait must sleep: where they spin, a second process on the same cores makes both 4 to 20 times
# slower. Read by the runtime once, when torch is first imported, hence here.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
