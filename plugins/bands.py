"""Built-in passbands, flat between two edges: each name in `EDGES` is an attribute of this module,
for an entry point.
"""

from __future__ import annotations

from zonda.core.instrument import Band

PAPER = "van Marrewijk, Morris et al. 2024, Table 1"
ROUND = (
    "stand-in: flat, with round edges after public descriptions; give a file of your own for the"
    " measured band"
)

EDGES = {
    # name: (GHz, GHz, provenance)
    "mustang2_90ghz": (78, 108, PAPER),
    "flat_150ghz": (
        128,
        172,
        "the 2 mm atmospheric window, a common choice for cosmic-microwave-background cameras",
    ),
    "atlast_92ghz": (66, 118, PAPER),
    "act_98ghz": (80, 116, ROUND),
    "act_150ghz": (126, 172, ROUND),
    "act_220ghz": (185, 265, ROUND),
    "so_93ghz": (77, 106, ROUND),
    "so_145ghz": (126, 168, ROUND),
    "so_225ghz": (196, 256, ROUND),
    "so_280ghz": (256, 312, ROUND),
    "spt3g_95ghz": (82, 108, ROUND),
    "spt3g_150ghz": (130, 168, ROUND),
    "spt3g_220ghz": (194, 246, ROUND),
    "toltec_150ghz": (128, 170, ROUND),
    "toltec_220ghz": (195, 245, ROUND),
    "toltec_280ghz": (245, 310, ROUND),
    "ccat_280ghz": (250, 310, ROUND),
    "ccat_350ghz": (330, 370, ROUND),
    "cmb_s4_95ghz": (78, 112, ROUND),
    "cmb_s4_150ghz": (128, 172, ROUND),
    "laboca_345ghz": (315, 375, ROUND),
}


def __getattr__(name: str) -> Band:
    if name not in EDGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    low, high, provenance = EDGES[name]
    return Band(name=name, low=f"{low} GHz", high=f"{high} GHz", provenance=provenance)


def __dir__() -> list[str]:
    return sorted(EDGES)
