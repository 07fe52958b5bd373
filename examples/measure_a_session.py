"""Measures a session and prints the step around the seam: `python examples/measure_a_session.py SESSION`."""

import sys

import weldscan

result = weldscan.inspect(sys.argv[1])
if result.step is None:
    sys.exit(f"{result.verdict}: {result.verdicts[0].reason}")
print(
    f"{result.verdict}: largest step {result.step.max_abs_mm:.3f} ± {result.step.expanded_uncertainty_mm:.3f} mm (k = 2)"
)
for angle, step, u in zip(result.step.angle_deg, result.step.step_mm, result.step.u_mm, strict=True):
    print(f"{angle:5.0f}°  {step:+.3f} ± {u:.3f} mm")
