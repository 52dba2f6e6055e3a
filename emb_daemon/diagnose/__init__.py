"""Closing the loop: residuals, their cause, a calibration that has it."""
