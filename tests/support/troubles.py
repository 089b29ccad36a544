"""Settings of runs with all link impairments and faults at once, which are still completed."""

# Only the shared control law tolerates a bad network.
RESILIENT = ("controller.prediction=closed_loop", "controller.relaxation=0.25")

# All link impairments at once, for all kinds of messages, within 1.5 s.
HEAVY = (
    "links={delay_s=0.06,jitter_s=0.1,loss=0.15,duplicate=0.2,reorder=0.2,reorder_s=0.1,rate_hz=15.0,"
    "gilbert_elliott={enter=0.1,leave=0.4},"
    "measurement={delay_s=0.05,jitter_s=0.05,loss=0.1,duplicate=0.1,reorder=0.1,reorder_s=0.1},"
    "actuation={delay_s=0.03,jitter_s=0.05,loss=0.1,duplicate=0.1,reorder=0.1,reorder_s=0.1},"
    "override=[{from='agent1',to='agent2',loss=0.5},{from='plant',to='agent3',distribution='normal',jitter_s=0.05}],"
    "partition=[{between=['agent3','plant'],start_s=0.4,end_s=0.6}],"
    "change=[{at_s=0.8,loss=0.3,rate_hz=20.0},{at_s=0.9,from='plant',delay_s=0.0}]}"
)
NEXT_TICK, ITERATIONS = "clock.actuation=next_tick", "controller.negotiation_iterations=2"

# One agent is frozen and continued, another is killed and restarted; for a while both are away. The
# timeout for a frozen agent stays at its default of 5 s: a busy host can stop any process for a
# second.
FAULTS = (
    "clock.on_agent_loss=continue",
    "faults.event=[{at_s=0.3,do='stop',target='agent2'},{at_s=0.7,do='continue',target='agent2'},"
    "{at_s=0.5,do='kill',target='agent4'},{at_s=0.9,do='restart',target='agent4'}]",
)
