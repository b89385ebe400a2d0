"""The doctor: what looks wrong in a log, with the evidence and the fix."""
