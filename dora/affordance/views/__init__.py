"""Pictures and the web page of objects, affordance maps and grasps."""
