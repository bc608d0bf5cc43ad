"""The hand as geometry: kinematics, capsules, meshes and the postures around a grasp."""
