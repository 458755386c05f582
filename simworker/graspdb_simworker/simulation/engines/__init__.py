"""Physics engines behind one interface, :class:`.world.EngineWorld`."""
