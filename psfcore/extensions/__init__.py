"""Code that users and operators add: effects of the gap library, simulators of blind sets."""
