"""Small RDDL texts for tests, written for them."""

from __future__ import annotations


def rddl(
    pvariables: str,
    cpfs: str,
    reward: str = "0",
    *,
    types: str = "",
    objects: str = "",
    values: str = "",
    start: str = "",
    sections: str = "",
    requirements: str = "",
    concurrent: str = "1",
    horizon: str = "horizon = 3;",
    discount: str = "discount = 0.9;",
) -> str:
    """A domain, its non-fluents and an instance in one text; sections that are empty are left out."""
    parts = [
        f"requirements = {{ {requirements} }};" if requirements else "",
        f"types {{ {types} }};" if types else "",
        f"pvariables {{ {pvariables} }};",
        f"cpfs {{ {cpfs} }};",
        f"reward = {reward};",
        sections,
    ]
    fluents = f"non-fluents {{ {values} }};" if values else ""
    things = f"objects {{ {objects} }};" if objects else ""
    init = f"init-state {{ {start} }};" if start else ""
    most = f"max-nondef-actions = {concurrent};" if concurrent else ""
    return (
        "domain d {\n" + "\n".join(part for part in parts if part) + "\n}\n"
        f"non-fluents n {{ domain = d; {things} {fluents} }}\n"
        f"instance i {{ domain = d; non-fluents = n; {init} {most} {horizon} {discount} }}\n"
    )


SERVERS = rddl(
    """LINK(server, server) : { non-fluent, bool, default = false };
    CRASH : { non-fluent, real, default = 0.1 };
    up(server) : { state-fluent, bool, default = true };
    restart(server) : { action-fluent, bool, default = false };""",
    """up'(?s) = if (restart(?s)) then KronDelta(true)
        else if (up(?s)) then Bernoulli(1 - CRASH * (1 + sum_{?t : server} [LINK(?t, ?s) ^ ~up(?t)]))
        else Bernoulli(0.05);""",
    "(sum_{?s : server} up(?s)) - 0.75 * (sum_{?s : server} restart(?s))",
    types="server : object;",
    objects="server : { s1, s2, s3 };",
    values="LINK(s1, s2); LINK(s2, s3); LINK(s3, s1); CRASH = 0.2;",
    start="~up(s2);",
)
"""A ring of three machines: a machine fails more often where the one before it is down."""

LIFE = rddl(
    """NEAR(cell, cell) : { non-fluent, bool, default = false };
    NOISE(cell) : { non-fluent, real, default = 0.1 };
    alive(cell) : { state-fluent, bool, default = false };
    set(cell) : { action-fluent, bool, default = false };""",
    """alive'(?c) = if (alive(?c) ^ ((sum_{?d : cell} (NEAR(?c, ?d) ^ alive(?d))) >= 2)
            | ~alive(?c) ^ ((sum_{?d : cell} (NEAR(?c, ?d) ^ alive(?d))) == 3) | set(?c))
        then Bernoulli(1 - NOISE(?c)) else Bernoulli(NOISE(?c));""",
    "sum_{?c : cell} [alive(?c) - set(?c)]",
    types="cell : object;",
    objects="cell : { a, b, c, d };",
    values=" ".join(f"NEAR({x}, {y});" for x in "abcd" for y in "abcd" if x != y) + " NOISE(c) = 0.05;",
    start="alive(a); alive(b);",
)
"""Four cells, each near all others; cells live on with two neighbours or more, are born with three."""

LIFT = rddl(
    """ABOVE(floor, floor) : { non-fluent, bool, default = false };
    CALL(floor) : { non-fluent, real, default = 0.0 };
    waiting(floor) : { state-fluent, bool, default = false };
    at(floor) : { state-fluent, bool, default = false };
    up : { action-fluent, bool, default = false };
    down : { action-fluent, bool, default = false };
    serve : { action-fluent, bool, default = false };""",
    """waiting'(?f) = if (waiting(?f) ^ ~(at(?f) ^ serve)) then KronDelta(true) else Bernoulli(CALL(?f));
    at'(?f) = if (up ^ exists_{?g : floor} [ABOVE(?g, ?f) ^ at(?g)]) then KronDelta(true)
        else if (down ^ exists_{?g : floor} [ABOVE(?f, ?g) ^ at(?g)]) then KronDelta(true)
        else if (up ^ exists_{?g : floor} ABOVE(?f, ?g)) then KronDelta(false)
        else if (down ^ exists_{?g : floor} ABOVE(?g, ?f)) then KronDelta(false)
        else KronDelta(at(?f));""",
    "(sum_{?f : floor} -waiting(?f)) - 0.25 * (up + down)",
    types="floor : object;",
    objects="floor : { f0, f1, f2 };",
    values="ABOVE(f0, f1); ABOVE(f1, f2); CALL(f0) = 0.1; CALL(f2) = 0.3;",
    start="at(f1); waiting(f0);",
    concurrent="2",
    sections="""state-action-constraints { (up + down + serve) <= 1; };""",
)
"""A lift with three floors; ABOVE(f, g): g is next above f.  The constraint forbids two actions at once."""

WALK = rddl(
    """NEXT(place, place) : { non-fluent, bool, default = false };
    GOAL(place) : { non-fluent, bool, default = false };
    RISK(place) : { non-fluent, real, default = 0.0 };
    robot(place) : { state-fluent, bool, default = false };
    go : { action-fluent, bool, default = false };
    back : { action-fluent, bool, default = false };""",
    """robot'(?p) =
        if (GOAL(?p) ^ robot(?p)) then KronDelta(true)
        else if (exists_{?q : place} (GOAL(?q) ^ robot(?q))) then KronDelta(false)
        else if ([go ^ exists_{?q : place} (NEXT(?q, ?p) ^ robot(?q))]
            | [back ^ exists_{?q : place} (NEXT(?p, ?q) ^ robot(?q))])
        then Bernoulli(1.0 - RISK(?p))
        else if ((go ^ robot(?p) ^ exists_{?q : place} NEXT(?p, ?q))
            | (back ^ robot(?p) ^ exists_{?q : place} NEXT(?q, ?p)))
        then KronDelta(false)
        else KronDelta(robot(?p));""",
    "[sum_{?p : place} -(GOAL(?p) ^ ~robot(?p))]",
    types="place : object;",
    objects="place : { p1, p2, p3 };",
    values="NEXT(p1, p2); NEXT(p2, p3); GOAL(p3); RISK(p2) = 0.25;",
    start="robot(p1);",
    sections="""termination { exists_{?p : place} (GOAL(?p) ^ robot(?p)); };
    action-preconditions { ~(go ^ robot(@p3)); back => ~robot(@p1); };""",
)
"""Three places in a row, the last the goal, where it ends; the robot vanishes on the way to p2 with 1/4."""

BOX = rddl(
    """CLEAR : { non-fluent, real, default = 0.8 };
    full : { state-fluent, bool, default = false };
    heard : { observ-fluent, bool };
    shaken : { observ-fluent, bool };
    shake : { action-fluent, bool, default = false };
    empty : { action-fluent, bool, default = false };""",
    """full' = if (empty) then KronDelta(false) else if (full) then KronDelta(true) else Bernoulli(0.3);
    heard = if (shake) then [if (full') then Bernoulli(CLEAR) else Bernoulli(1 - CLEAR)]
        else KronDelta(false);
    shaken = KronDelta(shake);""",
    "if (empty) then [if (full) then 5.0 else -3.0] else -0.5 * shake",
    requirements="partially-observed",
)
"""A box that fills; shaking it tells, with a chance, whether it is full after the step."""
