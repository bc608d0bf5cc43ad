"""Affordance toolbox: objects, affordance maps, grasp search, reach and views, without a simulator."""
