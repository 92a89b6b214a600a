"""The study of graphics cards: step, picture and frame on each backend of this machine, compared with the
processor's.
"""
