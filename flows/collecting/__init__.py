"""Taking trials: sessions at a rig, what happens between two trials, how a campaign is led."""
