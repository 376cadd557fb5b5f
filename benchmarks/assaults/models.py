"""Malformed models in MJCF and URDF."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.assaults.damage import damaged


def models(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    def scene(head: str = "", bodies: str = "", tail: str = "", joint: str = "", geom: str = "") -> bytes:
        return (
            f'<mujoco>{head}<worldbody><body name="object" pos="0 0 0.1"><freejoint/><geom size="0.02" {geom}/></body>'
            f'<body name="palm"><geom size="0.01"/><body pos="0 0 .03"><joint name="j" {joint}/>'
            f'<geom size="0.01"/></body></body>{bodies}</worldbody>{tail}</mujoco>'
        ).encode()

    good = scene(tail='<actuator><position joint="j" kp="1"/></actuator>')
    yield from damaged(good, draw, 60, 15)
    os.mkfifo(home / "pipe.xml")
    os.mkfifo(home / "pipe.stl")
    (home / "deep.xml").write_bytes(b"<mujoco>" + b'<include file="deep.xml"/>' + b"</mujoco>")
    for name in (
        "pipe.xml",
        "/dev/zero",
        "deep.xml",
        "../npz",
        "/etc/hostname",
        "nothing.xml",
        "",
        ".",
        "x" * 5000,
        "~",
    ):
        yield f"include_{name[:8].replace('/', '_')}", scene(head=f'<include file="{name}"/>')
        yield (
            f"attach_{name[:8].replace('/', '_')}",
            scene(
                head=f'<asset><model name="m" file="{name}"/></asset>',
                bodies='<attach model="m" body="palm" prefix="x"/>',
            ),
        )
    yield (
        "itself",
        lambda path: path.write_bytes(
            scene(
                head=f'<asset><model name="m" file="{path.name}"/></asset>',
                bodies='<attach model="m" body="palm" prefix="x"/>',
            )
        ),
    )
    yield "includes_itself", lambda path: path.write_bytes(scene(head=f'<include file="{path.name}"/>'))
    for name in ("pipe.stl", "/dev/zero", "/dev/null", "nothing.stl", "pipe.xml", "."):
        yield (
            f"mesh_{name.replace('/', '_')}",
            scene(head=f'<asset><mesh name="m" file="{name}"/></asset>', bodies='<geom type="mesh" mesh="m"/>'),
        )
        yield (
            f"texture_{name.replace('/', '_')}",
            scene(head=f'<asset><texture name="t" type="2d" file="{name}"/></asset>'),
        )
        yield (
            f"hfield_{name.replace('/', '_')}",
            scene(head=f'<asset><hfield name="h" file="{name}" size="1 1 1 1"/></asset>'),
        )
    for count in (0, -1, 3000, 10**6, 10**9, 10**20):
        yield (
            f"replicate_{count}",
            scene(bodies=f'<replicate count="{count}" offset="1 0 0"><body><geom size=".01"/></body></replicate>'),
        )
    nest = '<replicate count="40" offset="1 0 0">' * 4 + "<body><geom size='.01'/></body>" + "</replicate>" * 4
    yield "replicate_nested", scene(bodies=nest)
    for rows in (0, 10_000, 100_000, 2**31 - 1):
        yield (
            f"hfield_{rows}",
            scene(head=f'<asset><hfield name="h" nrow="{rows}" ncol="{rows}" size="1 1 1 1"/></asset>'),
        )
        yield (
            f"texture_{rows}",
            scene(head=f'<asset><texture name="t" type="2d" builtin="flat" width="{rows}" height="{rows}"/></asset>'),
        )
    for sizes in (
        'memory="1000000G"',
        'memory="-1"',
        'njmax="2000000000"',
        'nuserdata="2000000000"',
        'nkey="2000000000"',
    ):
        yield f"size_{sizes[:8]}", scene(head=f"<size {sizes}/>")
    for value in ("nan", "inf", "-inf", "1e999", "x", "", "1 2 3 4 5 6 7 8 9", "0", "-1"):
        yield f"gear_{value[:4]}", scene(tail=f'<actuator><motor joint="j" gear="{value}"/></actuator>')
        yield f"axis_{value[:4]}", scene(joint=f'axis="{value} 0 0"')
        yield f"mass_{value[:4]}", scene(geom=f'mass="{value}"')
        yield f"friction_{value[:4]}", scene(geom=f'friction="{value}"')
        yield f"range_{value[:4]}", scene(joint=f'limited="true" range="{value} 1"')
    for head in (
        '<!DOCTYPE a [<!ENTITY x "y">]>', '<!DOCTYPE a SYSTEM "file:///etc/passwd">',
        "<!DOCTYPE a [" + "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(12)) + "]>",
    ):  # fmt: skip
        yield "entities", head.encode() + good.replace(b'"palm"', b'"&e12;"')
    yield from texts(good)
    yield from large_texts(good)
    yield from assets(scene, home)
    yield "deep_bodies", scene(bodies='<body><geom size=".1"/>' * 20_000 + "</body>" * 20_000)
    yield "deep_400", scene(bodies='<body pos="0 0 1"><geom size=".1"/>' * 90 + "</body>" * 90)
    yield "attributes", scene(geom=" ".join(f'a{n}="1"' for n in range(20_000)))
    yield "long_name", scene(bodies=f'<body name="{"n" * 1_000_000}"><geom size=".1"/></body>')
    yield (
        "names",
        scene(bodies='<body name="a&#10;b"><geom size=".1"/></body><body name="&#27;[31m"><geom size=".1"/></body>'),
    )
    yield "twice", scene(bodies='<body name="palm"><geom size=".1"/></body>')
    yield "latin", b'<?xml version="1.0" encoding="iso-8859-1"?>' + good.replace(b"palm", b"p\xe4lm")
    yield "utf16", good.decode().encode("utf-16")
    yield (
        "composite",
        scene(bodies='<composite type="cable" count="1000000 1 1" size="1"><geom size=".1"/></composite>'),
    )
    yield (
        "flexcomp",
        scene(bodies='<flexcomp type="grid" count="2000 2000 2000" spacing=".1 .1 .1" name="f" radius=".01" dim="3"/>'),
    )
    yield "no_object", good.replace(b'name="object"', b'name="thing"')
    yield "urdf", b'<robot name="r"><link name="object"/></robot>'
    yield (
        "urdf_mesh",
        b'<robot name="r"><link name="object"><collision><geometry><mesh filename="pipe.stl"/></geometry></collision>'
        b"</link></robot>",
    )


def texts(good: bytes) -> Iterator[tuple[str, bytes]]:
    """XML that parsers have had trouble with."""
    text = good.decode()
    for encoding in ("utf-16-le", "utf-16-be", "utf-32", "utf-7", "cp500"):
        yield f"encoded_{encoding}", text.encode(encoding)
    for encoding in ("utf-16", "utf-7", "ebcdic-cp-us", "nonsense", "rot13", "x" * 5000, "hex"):
        yield f"declared_{encoding[:8]}", f'<?xml version="1.0" encoding="{encoding}"?>'.encode() + good
    yield "bom", b"\xef\xbb\xbf" + good
    yield "version", b'<?xml version="9.9"?>' + good
    yield "stylesheet", b'<?xml-stylesheet href="/dev/zero"?>' + good
    yield (
        "xinclude",
        good.replace(
            b"<worldbody>", b'<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/dev/zero"/><worldbody>'
        ),
    )
    yield "control", good.replace(b"palm", b"pa\x01lm")
    yield "nul", good.replace(b"palm", b"pa\0lm")
    yield "roots", good + good
    yield "attribute_twice", good.replace(b'name="palm"', b'name="palm" name="palm"')
    yield "unquoted", good.replace(b'"palm"', b"palm")
    yield "notation", b'<!DOCTYPE a [<!NOTATION n SYSTEM "/dev/zero">]>' + good
    yield "parameter", b'<!DOCTYPE a [<!ENTITY % p SYSTEM "file:///dev/zero"> %p;]>' + good


def large_texts(good: bytes) -> Iterator[tuple[str, bytes]]:
    yield "instructions", b"<?a b?>" * 1_000_000 + good
    yield "comment", b"<!--" + b"x" * 20_000_000 + b"-->" + good
    yield "comments", good.replace(b"<worldbody>", b"<worldbody>" + b"<!--x-->" * 500_000)
    yield "cdata", good.replace(b"<worldbody>", b"<worldbody><![CDATA[" + b"<body>" * 100_000 + b"]]>")
    yield "characters", good.replace(b"<worldbody>", b"<worldbody>" + b"&#65;" * 1_000_000)
    yield "nothing_but_text", good.replace(b"<worldbody>", b"<worldbody>" + b"x" * 20_000_000)
    yield "deep", b"<a>" * 1_000_000
    yield "deep_closed", b"<a>" * 300_000 + b"</a>" * 300_000
    yield "wide", good.replace(b"<worldbody>", b"<worldbody>" + b'<site size=".1"/>' * 300_000)
    yield "one_name", good.replace(b'"palm"', b'"' + b"p" * 10_000_000 + b'"')
    yield "namespaces", good.replace(b"<mujoco", b"<mujoco " + b" ".join(b'xmlns:n%d="u"' % n for n in range(50_000)))


def assets(scene: Any, home: Path) -> Iterator[tuple[str, Any]]:
    """Models that ask for other files, or for more than they say."""
    (home / "loop.stl").symlink_to("loop.stl")
    (home / "zero.stl").symlink_to("/dev/zero")
    (home / "folder.stl").mkdir()
    (home / "short.stl").write_bytes(bytes(84))
    for name in (
        "loop.stl",
        "zero.stl",
        "folder.stl",
        "short.stl",
        "../../../../etc/hostname",
        "/etc/hostname",
        "/proc/self/mem",
        "/dev/stdin",
        "file:///etc/hostname",
        "package://x/y.stl",
        "http://localhost/x.stl",
        "a\nb.stl",
        "%s%n.stl",
        "loop.stl/x.stl",
        "x" * 300 + ".stl",
    ):
        mesh = f'<asset><mesh name="m" file="{name}"/></asset>'.replace("\n", "&#10;")
        yield f"mesh_at_{len(name)}", scene(head=mesh, bodies='<geom type="mesh" mesh="m"/>')
        for folder in ("/", "/dev", "..", "zero.stl"):
            yield f"mesh_in_{len(name)}_{folder.strip('/.')}", scene(head=f'<compiler meshdir="{folder}"/>{mesh}')
    for label, mesh in {
        "few": 'vertex="0 0 0 1 0 0"',
        "flat": 'vertex="0 0 0 1 0 0 0 1 0 1 1 0"',
        "nan": 'vertex="0 0 0 nan 0 0 0 1 0 0 0 1"',
        "faces": 'vertex="0 0 0 1 0 0 0 1 0 0 0 1" face="0 1 99"',
        "negative": 'vertex="0 0 0 1 0 0 0 1 0 0 0 1" face="0 1 -2"',
        "scale": 'vertex="0 0 0 1 0 0 0 1 0 0 0 1" scale="0 0 0"',
        "huge": 'vertex="0 0 0 1e300 0 0 0 1 0 0 0 1"',
        "sphere": 'builtin="sphere" params="100000"',
        "supersphere": 'builtin="supersphere" params="100000 .5 .5"',
        "many": f'vertex="{"0.1 0.2 0.3 " * 300_000}"',
        "graph": 'vertex="0 0 0 1 0 0 0 1 0 0 0 1" maxhullvert="-5"',
    }.items():
        yield (
            f"inline_{label}",
            scene(head=f'<asset><mesh name="m" {mesh}/></asset>', bodies='<geom type="mesh" mesh="m"/>'),
        )
    for label, tail in {
        "plugin": '<extension><plugin plugin="mujoco.sdf.torus"/></extension>',
        "unknown": "<nonsense/>",
        "key": '<keyframe><key qpos="1"/></keyframe>',
        "keys": "<keyframe>" + "<key/>" * 100_000 + "</keyframe>",
        "equality": '<equality><weld body1="object" body2="nothing"/></equality>',
        "exclude": '<contact><exclude body1="palm" body2="palm"/></contact>',
        "skin": '<deformable><skin file="zero.stl"/></deformable>',
        "tendon": '<tendon><fixed><joint joint="j" coef="nan"/></fixed></tendon>',
        "sensor": '<sensor><user dim="1000000000"/></sensor>',
        "numeric": '<custom><numeric name="n" size="2000000000"/></custom>',
        "option": '<option timestep="nan"/>',
        "gravity": '<option gravity="inf 0 0"/>',
        "timestep": '<option timestep="-1"/>',
        "defaults": '<default><default class="a">' * 50 + "</default></default>" * 50,
        "delay": '<actuator><general joint="j" dyntype="user" actdim="1000000000"/></actuator>',
    }.items():
        yield f"tail_{label}", scene(tail=tail)
