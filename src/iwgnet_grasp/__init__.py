"""Pick parts from a pile: perception, planning and trials around the C++ core."""

from pkgutil import extend_path

# The extension _core and the messages lie in the devel space, in a package of the same name:
# whichever of the two is found first, the other belongs to it.
__path__ = extend_path(__path__, __name__)
