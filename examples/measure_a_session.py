"""Measures a session and prints the step around the seam: `python examples/measure_a_session.py SESSION`."""

import sys

import weldscan

result = weldscan.inspect(sys.argv[1])
if result.step is None:
    sys.exit(f"{result.verdict}: {result.verdicts[0].reason}")
step = result.step
print(f"{result.verdict}: largest step {step.max_abs_mm:.3f} ± {step.expanded_uncertainty_mm:.3f} mm (k = 2)")
for angle, step_mm, u_mm in zip(step.angle_deg, step.step_mm, step.u_mm, strict=True):
    print(f"{angle:5.0f}°  {step_mm:+.3f} ± {u_mm:.3f} mm")
