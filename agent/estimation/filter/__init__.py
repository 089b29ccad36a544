"""The Kalman filter of the team: its belief, its noise, its unknown forces, the part of silent agents."""
