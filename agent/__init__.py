"""Agent: estimates the state, plans the inputs of its UAVs, sends the plan to the others."""
