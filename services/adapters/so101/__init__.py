"""The SO-101 arm: six Feetech bus servos on a serial line."""
