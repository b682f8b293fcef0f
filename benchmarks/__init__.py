"""Speed and ablations; run them as `python -m benchmarks.<name>` from the project's root.

`one_process` is a simulated machine for them and for tests.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: small products wait for threads

from brokk_min._files import SHIPPED
from brokk_min.machine import BROKK_170

POLICY = SHIPPED / BROKK_170.name / "policy.npz"  # ours; it holds the nets of the driven joints
