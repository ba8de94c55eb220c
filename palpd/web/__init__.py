"""The operator's page: a process of its own that shows what the service does and passes on what the operator asks for.

It opens no device, writes neither ring nor recordings, and decides nothing: every request goes through the control socket of the service,
and every refusal is the service's own sentence. Where it hangs or dies, the loop notices nothing.
"""
