"""The trainer: its commands, what they stand on, and rooms for the parts."""

from trainers.common.shadowing import refuse_other_packages

refuse_other_packages()
