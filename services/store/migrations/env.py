"""What Alembic runs for any of its commands: the revisions, on the connection that services/store/migrate.py opened."""

from alembic import context

context.configure(connection=context.config.attributes["connection"], transaction_per_migration=False)
context.run_migrations()
