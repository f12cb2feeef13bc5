"""Many independent runs on a distributed engine: populations of arms, Monte Carlo, fault campaigns, fleets of
recordings.
"""
