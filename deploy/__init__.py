"""From one host to several: keys, folders for each host, services, and a lab of network namespaces."""
