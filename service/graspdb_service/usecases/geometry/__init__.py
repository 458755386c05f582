"""What the object's mesh says: collisions, edges, pairs of surfaces."""
