"""Commands that make gripper profiles, and explain them."""
