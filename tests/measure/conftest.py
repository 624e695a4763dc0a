"""Projects to measure in."""

import pytest
from mitsuba_bdpt.measure.making import Job
from mitsuba_bdpt.measure.project import Project
from support.measured import new_project


@pytest.fixture
def folder(tmp_path):
    return new_project(tmp_path)


@pytest.fixture
def project(folder):
    return Project(folder)


@pytest.fixture
def job(project):
    """Makes jobs: the reference of a scene, 8 pixels wide, of some depth."""

    def made(max_depth, name="cornell_box", **more):
        return Job(project, project.scene(name), 8, max_depth, **({"spp": 4} | more))

    return made
