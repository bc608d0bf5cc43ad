"""Pictures and the web page of objects, maps and grasps; nothing here computes a grasp."""
