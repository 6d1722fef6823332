"""The storm: whole campaigns under every fault at once, in virtual time, replayed from a seed."""
