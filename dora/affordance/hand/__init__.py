"""The hand as geometry: kinematics, capsules, meshes, postures around a grasp, and the numbers of the grasp test."""
