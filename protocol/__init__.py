"""Communication between the processes: messages, scenario, admission of messages, network."""
