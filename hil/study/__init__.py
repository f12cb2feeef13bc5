"""Many independent runs on a distributed engine: populations of arms, Monte Carlo studies, fault campaigns and
large sets of recordings.
"""
