"""The lab's recordings of before: pickles of events, videos and forces in a run's folder."""
