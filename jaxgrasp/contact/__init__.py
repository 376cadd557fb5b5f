"""What touches what: contacts, friction, the grasp map and compliance."""

from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.grasp_map import grasp_map, required_wrench

__all__ = ["Actuation", "Compliance", "Contacts", "grasp_map", "required_wrench"]
