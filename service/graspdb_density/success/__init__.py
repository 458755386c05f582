"""How likely a grasp is to hold: estimates from successes and failures, and how good they are."""
