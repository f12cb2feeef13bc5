"""Many independent runs on a distributed engine: populations, Monte Carlo, fault campaigns, fleets of recordings."""
