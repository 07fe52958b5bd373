"""The weld: walls and cap of one shot, the step of all shots, the paper's method, and the whole inspection."""

from weldscan._later import later
from weldscan._weldcore import (
    WeldShot,
    WeldStep,
    label_weld,
    measure_step,
    place_shots,
    seam_fates,
    segment_weld,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from weldscan.measure.inspection import (
        inspect,
    )
    from weldscan.measure.paper_method import (
        paper_step,
    )
    from weldscan.norms import (
        judge,
        limit_mm,
        norm_ids,
    )

__getattr__ = later(
    __name__,
    {
        "weldscan.measure.inspection": ("inspect",),
        "weldscan.measure.paper_method": ("paper_step",),
        "weldscan.norms": ("judge", "limit_mm", "norm_ids"),
    },
)

__all__ = [
    "WeldShot",
    "WeldStep",
    "inspect",
    "judge",
    "label_weld",
    "limit_mm",
    "measure_step",
    "norm_ids",
    "paper_step",
    "place_shots",
    "seam_fates",
    "segment_weld",
]
