"""What people look at while they work: the review page, a trial in Rerun, live detection."""
