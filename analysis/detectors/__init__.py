"""When slip is seen: from a trial's windows to onsets, detectors side by side, and the live one."""
