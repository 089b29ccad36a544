"""Figure of cost over delay: the paper's algorithm and `resilient`, 8 runs, some 15 s on two cores.

python examples/delay.py
"""

import transport

table = transport.sweep(["paper", "resilient"], {"links.delay_s": [0.0, 0.05, 0.1, 0.2]})
print(table)
table.plot().savefig("delay.png")
print("delay.png")
