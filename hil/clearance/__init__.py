"""How near a spatial arm comes to itself, the floor and boxes, from the collision geometry of its URDF.

mesh     corner points of a mesh file
shapes   capsules that enclose each link
kernel   compiled distances along a motion
space    the arm among what it must not touch
"""
