"""An agent: estimates the state, plans for the UAVs it owns, tells the others."""
