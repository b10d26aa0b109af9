#!/usr/bin/env python3
"""Writes subsets.txt, the named subsets of the CMU mocap files, from dm_control's own list.

    python3 make_subsets.py PATH/TO/dm_control/locomotion/tasks/reference_pose/cmu_subsets.py > subsets.txt

The list is parsed, not imported, so dm_control need not be installed.
"""

import ast
import collections
import sys

HEADER = """\
# Named subsets of the CMU motion-capture clips, as dm_control 1.0.49 (Apache-2.0) lists them in
# locomotion/tasks/reference_pose/cmu_subsets.py. Made by make_subsets.py.
# A line without indentation names a subset; below it, a subject and its takes: `009 01 02` is CMU_009_01, CMU_009_02.
"""


def main():
    tree = ast.parse(open(sys.argv[1]).read())
    ids, names = {}, []
    for node in tree.body:
        if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Call):
            continue
        keywords = {keyword.arg: keyword.value for keyword in node.value.keywords}
        if "ids" in keywords:
            ids[node.targets[0].id] = ast.literal_eval(keywords["ids"])
        else:
            names = [(name, value.id) for name, value in keywords.items()]
    print(HEADER, end="")
    for name, variable in names:
        print(name)
        subjects = collections.defaultdict(list)
        for clip in ids[variable]:
            prefix, subject, take = clip.split("_", 2)
            assert prefix == "CMU", clip
            subjects[subject].append(take)
        for subject, takes in subjects.items():
            print(f"  {subject} {' '.join(takes)}")


main()
