"""ABB arms on an IRC5 controller: motion programs with EGM poses, or a RAPID socket server."""
