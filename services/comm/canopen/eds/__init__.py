"""Electronic data sheets (CiA 306) of the devices on the CAN buses."""
