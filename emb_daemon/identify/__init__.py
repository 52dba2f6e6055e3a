"""From a rig campaign to a calibration."""
