"""Agent: estimates the state, plans the inputs of the UAVs it owns, sends the plan to the others."""
