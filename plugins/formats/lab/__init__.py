"""The lab's older recordings: pickles of events, videos and forces in a run's folder."""
