"""The measurement: a session in, the step of its weld with U and verdicts out. `inspection` has it on one screen."""
