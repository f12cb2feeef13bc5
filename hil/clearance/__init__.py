"""Clearance of a spatial arm from itself, the floor and boxes, from the collision geometry of its URDF.

mesh     vertices of a mesh file
shapes   capsules that enclose each link
kept     the capsules, stored in a file next to a copied description
kernel   compiled distance computations along a motion
space    the arm and its obstacles
doubts   warnings about the description of an arm
"""
