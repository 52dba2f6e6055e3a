"""From a rig campaign to a calibration, with the evidence."""
