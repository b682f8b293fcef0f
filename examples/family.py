"""Members of the Brokk's family, each with physics of its own: `--machine examples/family.py:M3`.

brokk-min collect --machine examples/family.py:M3 --excitation joint --out log.npz
brokk-min fit log.npz --machine examples/family.py:M3 --shared 4 --out net.npz
"""

from brokk_min.identification.physics import draw_machine
from brokk_min.machine import BROKK_170

M0, M1, M2, M3, M4, M5, M6, M7 = (draw_machine(BROKK_170, seed) for seed in range(8))
