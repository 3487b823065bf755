"""What a plan is made of: depths of fibres, their leads, and numbers."""
