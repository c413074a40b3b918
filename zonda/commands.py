"""The built-in commands and where they are, imported when they are named or listed.

Through the hook `zonda_commands`, as a third party's, they would cost ``zonda --help`` 60 ms more:
pluggy and the metadata.
"""

COMMANDS = {
    "accuracy": "zonda.core.accuracy.command:accuracy",
    "check": "zonda.core.cli.run:check",
    "compile": "zonda.core.cli.run:compile_kernels",
    "completion": "zonda.core.cli.listing:completion",
    "compare": "zonda.plugins.commands.compare:compare",
    "doctor": "zonda.plugins.commands.doctor:doctor",
    "new": "zonda.plugins.commands.new:new",
    "noise": "zonda.plugins.commands.noise:noise",
    "pipelines": "zonda.core.cli.listing:pipelines",
    "plan": "zonda.core.plan.command:plan",
    "plugins": "zonda.core.cli.listing:plugins",
    "resume": "zonda.core.campaign.command:resume",
    "run": "zonda.core.cli.run:run",
    "schema": "zonda.core.cli.listing:schema",
    "sensitivity": "zonda.plugins.commands.sensitivity:sensitivity",
    "show": "zonda.plugins.commands.show:show",
    "status": "zonda.core.campaign.command:status",
    "validate": "zonda.plugins.validation.command:validate",
    "weather": "zonda.plugins.commands.weather:weather",
    "when": "zonda.plugins.commands.when:when",
}
