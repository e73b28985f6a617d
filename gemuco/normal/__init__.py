"""What is normal: statistics of a healthy body's prediction errors, alone and over windows, and the watch (II-K)."""

from gemuco.normal.statistics import Normal as Normal
