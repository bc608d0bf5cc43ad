"""What is known of raw triangle surfaces: which faces are double, how bodies lie to each other, what they weigh."""
