"""The parts that all drives share: automaton, profiles, modes, inputs, protection; SI units throughout."""
