from hypothesis import settings

# A property says nothing about time: a busy machine may take long over an example.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
