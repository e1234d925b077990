"""What a configuration may say: the registry of terms, values per joint, the settings of the physics engines.

Nothing here builds anything, and nothing here imports torch or an engine.
"""
